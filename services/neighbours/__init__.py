"""Robots of a LAN hear each other, and scripts of one drive another that lets them."""
