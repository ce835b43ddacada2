"""temporary"""
def rolling_torques(n, w):
    return [0.0]*len(n.shafts)
