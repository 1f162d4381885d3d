"""What a problem is made of: variables, groups of residuals and how they are laid out."""
