"""The report: one file without secrets, by which a fault can be found from elsewhere."""
