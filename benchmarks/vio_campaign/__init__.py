"""The campaign of random camera recordings: what a seed stands for, and the verdict on what is said of it."""
