"""Comparisons of variants, all measured in one run on one machine."""
