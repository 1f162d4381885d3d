"""Reports of bundle adjustment, of lines and of pose graphs."""
