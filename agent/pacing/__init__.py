"""The clock of a paced run, as data: nothing here looks at one. Times are seconds of whatever clock the caller has."""
