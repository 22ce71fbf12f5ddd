"""Conversion of recordings to other formats, and back."""
