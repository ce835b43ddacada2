"""The back end for CPUs: prints a program as LLVM IR, and compiles it by llvmlite."""
