"""Plays sound clips: one at a time, through the robot's player."""
