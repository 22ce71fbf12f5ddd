"""Pictures and sound on the wire: encoders, decoders, and what makes up for lost packets."""
