"""User functions as pytrees: captured numbers become arguments, the rest the cache key."""
