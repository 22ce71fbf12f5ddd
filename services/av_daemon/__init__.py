"""The one owner of camera and microphone: captures while somebody looks or listens, for any number of readers."""
