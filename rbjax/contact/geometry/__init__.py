"""Where geoms touch: closed-form contacts of pairs of shapes, and detection for a whole robot."""
