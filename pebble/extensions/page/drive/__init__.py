"""Who drives which robot from one server: leases of pages, wishes at robots that decide themselves, other servers."""
