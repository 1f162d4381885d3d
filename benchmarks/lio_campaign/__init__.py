"""Random recordings for `boxplus lio`, and whether every run ends right or says what is wrong. See ../campaign.py."""
