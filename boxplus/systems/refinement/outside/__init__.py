"""What a run knows beside its scans and its IMU, as measurements of keyframes."""
