"""The report: what helps to find a fault from elsewhere, in one file without a secret."""
