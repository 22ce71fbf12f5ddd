"""``pebble fleet``, and what else concerns more than one robot: hubs, gateways, the audit."""
