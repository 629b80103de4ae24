"""Web page that answers clicks, over a bag or a robot. Imports every package except `cli`."""
