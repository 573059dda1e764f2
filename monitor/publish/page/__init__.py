"""The one page: a sheet of blocks, its charts, and the template, style and script that reports and live page share."""
