"""Perception for scripts: tags in pictures, distances from wheels, and controllers that use both.

Pure: pictures, samples and times are passed in, poses and drive commands are returned.
"""
