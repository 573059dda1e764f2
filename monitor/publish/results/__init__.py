"""Result lines and summaries of a run."""
