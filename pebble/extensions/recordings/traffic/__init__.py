"""What recordings say about robots and networks: index, analysis, report."""
