"""Robots on an impaired network: the impairment trials of the paper, chapter 4.2, as a program."""
