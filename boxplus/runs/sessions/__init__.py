"""`boxplus map merge`: several runs of one place, one map."""
