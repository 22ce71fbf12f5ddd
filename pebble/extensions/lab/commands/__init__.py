"""The commands of the extension lab: ``sim``, ``demo`` and ``bench``."""
