"""`boxplus refine`: a finished run of odometry optimised as a whole."""
