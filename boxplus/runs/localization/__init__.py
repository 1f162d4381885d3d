"""`boxplus localize`: odometry over a recording, and where it is in a saved map."""
