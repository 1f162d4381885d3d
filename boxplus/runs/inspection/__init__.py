"""The data doctor: examines a recording before an estimator believes it."""
