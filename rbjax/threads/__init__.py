"""Any function of one sample as one GPU thread."""
