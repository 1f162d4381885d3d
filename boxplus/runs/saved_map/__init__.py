"""A map from an earlier run, or a bare point cloud, opened to be located in or merged (docs/localization.md)."""
