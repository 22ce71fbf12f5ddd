"""Extensions of Pebble that live here: a folder each, which the rest of Pebble does not import."""
