"""Functions of a user as pytrees: captured numbers are arguments of a program, the rest its key."""
