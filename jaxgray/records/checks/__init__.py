"""What can be said of a record before any model: defects of channels, and of channels beside one another.

preflight        all findings on a raw record
looked           a record with what several checks look at
finding          one finding
channel_checks   checks of single channels
defects          detectors for these
relation_checks  checks of how outputs follow inputs
relations        detectors for these
answers          difference equations from inputs to outputs
modes            time and sign of a response
"""
