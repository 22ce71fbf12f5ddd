"""A robot behind a bad link: the impairment trials of the paper, chapter 4.2, as a program."""
