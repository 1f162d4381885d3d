"""LiDARs on one body checked against each other: do they see the same surfaces where their mounting and clocks say."""
