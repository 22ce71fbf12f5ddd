"""Perception: tags in pictures, distance from wheels, and what a robot does about both.

Pure: pictures, samples and times are passed in, poses and drive commands are returned.
"""
