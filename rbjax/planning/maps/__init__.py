"""Maps of occupied cells, their distance fields, and footprints on them."""
