"""Analysis of robots and networks by recordings: index, analysis, report."""
