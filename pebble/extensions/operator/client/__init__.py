"""The operator's side as a library: which robots there are, and how to request and receive their pictures and sound."""
