"""From sightings to a survey: rests, legs, stations, adjustment, and files that surveyors use."""
