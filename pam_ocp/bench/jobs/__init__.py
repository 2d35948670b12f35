"""What the page has done in other processes: functions of plain values, without a framework."""
