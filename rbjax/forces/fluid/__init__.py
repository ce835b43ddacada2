"""Forces of a fluid on bodies."""
