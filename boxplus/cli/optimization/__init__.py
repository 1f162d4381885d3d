"""Commands that optimise a file: bundle adjustment and pose graphs."""
