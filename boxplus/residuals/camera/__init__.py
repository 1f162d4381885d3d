"""What cameras measure: points, points by their inverse depth, lines, grey values; on poses of cameras or of their body."""
