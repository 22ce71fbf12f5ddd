"""What makes a newer version safe to take: signed releases."""
