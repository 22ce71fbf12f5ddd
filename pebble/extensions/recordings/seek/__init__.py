"""Looks into recordings at any moment: messages of a time, the state before it, pictures, days."""
