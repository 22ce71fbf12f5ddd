"""The operator page: one process between browsers and the remote broker, and the page that it serves."""
