"""An operator's voice: evened out, and handed to a program that plays it."""
