"""From an installed package to a robot that runs: questions, one config, credentials, a unit; backups of all that."""
