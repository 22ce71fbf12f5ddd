"""Pictures and sound on the wire: encoders, decoders, a jitter buffer, and computed test material."""
