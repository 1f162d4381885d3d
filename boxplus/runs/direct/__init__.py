"""Direct odometry over a recording: settings, folder, frames, summary."""
