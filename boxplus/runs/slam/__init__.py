"""`boxplus slam`: odometry over a recording, with loops closed beside it."""
