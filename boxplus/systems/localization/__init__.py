"""Localisation in a saved map: where the odometry's world lies in it. Derivations: docs/localization.md."""
