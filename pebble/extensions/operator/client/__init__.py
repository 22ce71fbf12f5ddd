"""The client library of operators: it finds robots, requests their media, drives and stops them."""
