"""Export of results for other programs: CSV, Parquet, InfluxDB line protocol, universal files, and datasets of many sites."""
