"""The set-up of a robot: questions, config, credentials and unit; and backups of all these."""
