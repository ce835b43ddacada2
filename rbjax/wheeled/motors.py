"""Motors: the torque of a control."""
from rbjax.model.record import Record
class Motor(Record):
    def reflected(self, dtype): return 0.0
    def torque(self, u, W): return u
    def free_speed(self, u): return u
class TorqueSource(Motor):
    pass
