"""Self-describing MCUs as parts of a robot: their channels, aliases and peers, and the service that runs them."""
