"""What two results differ by, and whether that is more than noise."""
