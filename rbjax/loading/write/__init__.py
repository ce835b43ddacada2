"""Writing a `Model`: as a new MJCF file, or as changed values in the file that it came from."""
