// Which cards there are, in the order of their importance. A new one is a line here, and a module that is fetched when it
// is shown.

import { styled } from "../parts/hooks.js";

/**
 * ``tab``: where it is on a phone. ``wants``: whether this component has it. ``part``: fetches what draws it; a
 * component with ``at`` and ``offers``. ``engineers``: below all others, and closed until it is opened. ``height``: px
 * that it usually has, by which its column is chosen, and that are kept free for it until it is here; ``sideHeight``:
 * if it is another one in the narrow column. ``wide``: it may span several columns. ``sends``: it is for commands only,
 * so screens that only watch are without it.
 * @typedef {{id: string, title: string, icon: string, tab: string, wants: (offers: any) => boolean,
 *   part: (again: string) => Promise<any>, engineers?: boolean, height?: number, sideHeight?: number, wide?: boolean,
 *   sends?: boolean}} CardKind
 */

/** Which keys drive. */
export const KEYS = styled(async (again) => (await import("../robot/drive-settings.js" + again)).KeyHints, "panels.css");

/** How the inputs are scaled, and the extra axis. */
export const DRIVE = styled(async (again) => (await import("../robot/drive-settings.js" + again)).DriveSettings, "panels.css");

/** How the picture comes, and where from. */
export const PICTURE = styled(async (again) => (await import("../robot/picture-settings.js" + again)).PictureSettings, "picture.css");

/** Where else a picture may come from. */
export const NO_CAMERA = styled(async (again) => (await import("../robot/picture-settings.js" + again)).NoCamera, "picture.css");

/** Listening and talking; a desktop has them below the picture. */
export const VOICE = styled(async (again) => (await import("../robot/sound.js" + again)).SoundControls, "sound.css");

/** How the sound comes. */
export const SOUND_FACTS = styled(async (again) => (await import("../robot/sound.js" + again)).SoundFacts, "sound.css");

/** What lies over a picture that is the whole page. */
export const HUD = styled(async (again) => (await import("../robot/hud.js" + again)).Hud, "picture.css", "map.css");

/** What belongs to a picture besides it. */
export const EXTRAS = styled((again) => import("../robot/picture-extras.js" + again), "picture.css");

/** @type {CardKind[]} */
export const CARDS = [
  {
    id: "autonomy",
    sends: true,
    title: "Scripts",
    icon: "script",
    tab: "more",
    height: 233,
    wants: (offers) => offers.has("autonomy"),
    part: styled(async (again) => (await import("./autonomy.js" + again)).Autonomy, "commands.css"),
  },
  {
    id: "telemetry",
    title: "State",
    icon: "gauge",
    tab: "sensors",
    height: 250,
    wants: () => true,
    part: async (again) => (await import("./telemetry.js" + again)).Telemetry,
  },
  {
    id: "map",
    title: "Map",
    icon: "map",
    tab: "sensors",
    height: 412,
    wants: (offers) => offers.received("wheel-odometry") || offers.received("localization-pose"),
    part: styled(async (again) => (await import("./map.js" + again)).Odometry, "map.css"),
  },
  {
    id: "plots",
    title: "Plots",
    icon: "plot",
    tab: "sensors",
    height: 347,
    sideHeight: 566,
    wide: true,
    wants: () => true,
    part: styled(async (again) => (await import("./plots.js" + again)).Plots, "plots.css", "vendor/uPlot.css"),
  },
  {
    id: "voice",
    title: "Listen and talk",
    icon: "mic",
    tab: "sound",
    height: 150,
    wants: (offers) => offers.has("audio"),
    part: VOICE,
  },
  {
    id: "sounds",
    sends: true,
    title: "Sounds",
    icon: "sound",
    tab: "sound",
    height: 358,
    wants: (offers) => offers.has("soundboard"),
    part: styled(async (again) => (await import("./sounds.js" + again)).Sounds, "commands.css"),
  },
  {
    id: "lights",
    sends: true,
    title: "Lights",
    icon: "light",
    tab: "more",
    height: 202,
    sideHeight: 304,
    wants: (offers) => ["solid", "flash", "available"].some((kind) => offers.section("lights")[kind] === true),
    part: styled(async (again) => (await import("./lights.js" + again)).Lights, "commands.css"),
  },
  {
    id: "outlets",
    sends: true,
    title: "Outlets",
    icon: "plug",
    tab: "more",
    height: 372,
    wants: (offers) => offers.section("outlets").available === true || offers.received("outlets/"),
    part: styled(async (again) => (await import("./outlets.js" + again)).Outlets, "devices.css"),
  },
  {
    id: "services",
    engineers: true,
    title: "Services",
    icon: "list",
    tab: "more",
    wants: (offers) => offers.isRobot && offers.received("status"),
    part: styled(async (again) => (await import("./services.js" + again)).Services, "system.css"),
  },
  {
    id: "mcus",
    sends: true,
    engineers: true,
    title: "Microcontrollers",
    icon: "chip",
    tab: "more",
    wants: (offers) => offers.metrics.some((metric) => metric.endsWith("/describe")),
    part: styled(async (again) => (await import("./mcus.js" + again)).Mcus, "devices.css"),
  },
  {
    id: "logs",
    engineers: true,
    title: "Logs",
    icon: "list",
    tab: "more",
    wants: (offers) => offers.isRobot,
    part: styled(async (again) => (await import("./logs.js" + again)).Logs, "system.css"),
  },
  {
    id: "values",
    engineers: true,
    title: "All values",
    icon: "list",
    tab: "more",
    wants: () => true,
    part: styled(async (again) => (await import("./values.js" + again)).Values, "devices.css"),
  },
  {
    id: "system",
    sends: true,
    engineers: true,
    title: "System",
    icon: "power",
    tab: "more",
    wants: (offers) => offers.has("system"),
    part: styled(async (again) => (await import("./system.js" + again)).System, "system.css", "panels.css"),
  },
];

/** @param {any} offers */
export const hasMap = (offers) => CARDS.some(({ id, wants }) => id === "map" && wants(offers));

/** Tabs of a phone, in order; those without any card are left out. */
export const TABS = [
  { id: "drive", title: "Drive", icon: "wheel" },
  { id: "sensors", title: "Sensors", icon: "gauge" },
  { id: "sound", title: "Sound", icon: "sound" },
  { id: "more", title: "More", icon: "list" },
];
