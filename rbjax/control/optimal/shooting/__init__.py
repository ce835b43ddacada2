"""Shooting methods: DDP, SQP, single shooting, sampling, and their iterations."""
