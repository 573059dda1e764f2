"""Sources of sample blocks: files now, buses next.  Knows nothing of ``monitor``."""
