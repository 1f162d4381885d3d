"""Visual-inertial odometry over files: settings, rig, output folder, facts."""
