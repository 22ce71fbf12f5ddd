"""Recordings in other forms, and back."""
