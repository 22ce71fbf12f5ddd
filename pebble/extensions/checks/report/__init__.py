"""The report: one file, without secrets, by which somebody elsewhere can find a fault."""
