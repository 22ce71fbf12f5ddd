"""The set-up of a machine: its packages, its config, its boards, backups."""
