"""Random sequences of inputs and faults in Chromium, judged by the motors of whole robots."""
