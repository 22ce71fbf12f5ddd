"""Analysis of robots and networks from recordings: index, analysis, report."""
