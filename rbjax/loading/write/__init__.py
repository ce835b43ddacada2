"""A `Model` written as MJCF, or into the file that it came from."""
