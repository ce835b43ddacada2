"""Methods that keep structure: Lie groups, splittings, second-order equations."""
