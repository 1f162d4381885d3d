"""The covariance that an estimate states of its pose: with the errors of its map, and as its points bear it out."""
