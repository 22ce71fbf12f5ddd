"""Publishes recordings again."""
