// What values from other programs are, and how their texts are shown.

/** @param {unknown} value @returns {value is Record<string, any>} */
export const isObject = (value) => typeof value === "object" && value !== null && !Array.isArray(value);

const STEERS = /(?![\t\n])[\p{Cc}\p{Cf}\p{Cs}\p{Zl}\p{Zp}\p{DI}\u2800]/gu;
const JOINS_NOTHING = /(^|[\0-\x7f\p{Cc}\p{Cf}\p{Z}\p{DI}\u2800])$/u; // what ends so

/**
 * What is not seen, or steers the text around it, is its code: the rule of pebble/config/visible.py.
 * @param {any} text @returns {any} what is no text stays as it is
 */
export const visible = (text) =>
  text.replace?.(STEERS, (char, at) => {
    const joins = /[\u200c\u200d\ufe00-\ufe0f]/.test(char) && !JOINS_NOTHING.test(text.slice(0, at));
    if (joins && (char > "\u2fff" || text[at + 1] > "\x7f")) return char;
    const code = char.codePointAt(0).toString(16);
    return code[4] ? "\\U" + code.padStart(8, "0") : "\\u" + code.padStart(4, "0");
  }) ?? text;
