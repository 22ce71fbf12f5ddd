"""From a blank machine to a robot that runs: questions, steps, and the manifest that undoes them."""
