"""The back end of CPUs: prints a program as LLVM IR, and compiles it by llvmlite."""
