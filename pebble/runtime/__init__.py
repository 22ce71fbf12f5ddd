"""What every process of a robot is built on: service, inbox, timers, connections, and notifications to the launcher."""
