"""Archives: replay and diagnosis of many recordings in parallel."""
