"""Readers that turn a bag, an MCAP file, a pcap or a folder into scans and IMU samples, streaming."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
