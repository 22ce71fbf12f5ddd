"""The protocol of text lines of motor boards, `goob_base_v1`, and its service."""
