"""HTML reports of a diagnosis and of a period."""
