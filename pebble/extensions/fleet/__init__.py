"""People and certificates: who may use the operator page, what they did, and the small authority that signs for it."""
