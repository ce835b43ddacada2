"""Drivers run a recursion over the tree: unrolled, by limbs, or as a loop over the links."""
