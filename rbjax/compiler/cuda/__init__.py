"""The back end for NVIDIA GPUs: prints a program as CUDA C, and compiles it by NVRTC."""
