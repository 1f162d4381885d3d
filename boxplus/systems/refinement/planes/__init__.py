"""What the points of scans say of planes, however many points there are."""
