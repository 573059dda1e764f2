"""Publishers: everything that shows or stores results.  Their failure never stops the monitor."""
