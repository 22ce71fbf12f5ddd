"""The stand-in for a script of the original, as a script of this robot."""

from tests.fakes.original_locations import main

main()
