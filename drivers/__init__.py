"""Sources of sample blocks: recordings, CAN and Zenoh.  This package imports nothing of ``monitor``."""
