// The operator's page: its parts, and the link that feeds them.

import { Bar } from "./bar.js";
import { Events } from "./events.js";
import { Fit } from "./fit.js";
import { useUnits } from "./format.js";
import { Gauges } from "./gauges.js";
import { Link } from "./link.js";
import { LiveResponse } from "./response.js";
import { Rig } from "./rig.js";
import { Sessions } from "./sessions.js";
import { StartForm } from "./start.js";
import { Strips } from "./strips.js";

const link = new Link();
link.on("hello", ({ units }) => useUnits(units));
for (const Part of [Bar, Gauges, Strips, Fit, LiveResponse, StartForm, Rig, Sessions, Events]) {
  new Part(link);
}
link.connect();
