"""A path that grows scan by scan: what registers a scan, and at which speeds it may begin."""
