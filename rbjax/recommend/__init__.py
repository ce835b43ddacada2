"""What to choose for a robot and a motion, measured on them: `solver`, `formulation`."""
