"""What commands show and ask on a terminal: help, progress, results, outcomes, a view in 3D, and how they are interrupted."""
