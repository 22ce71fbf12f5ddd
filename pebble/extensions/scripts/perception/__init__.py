"""What a robot makes of its sensors: tags in pictures, distance from its wheels, and what to do about both.

Pure: pictures, samples and times are passed in, poses and drive commands are returned.
"""
