"""An estimator over files: its settings, its output folder, what it writes there, and how a run ends."""
