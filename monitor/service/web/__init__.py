"""Read-only web page of the daemon: what it shows, as JSON and as a page, and how it is asked for."""
