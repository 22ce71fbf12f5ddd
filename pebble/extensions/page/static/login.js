/** The login page: sends user and password as JSON, and shows why they were refused. */

const form = document.getElementById("login");
const user = /** @type {HTMLInputElement} */ (document.getElementById("user"));
const password = /** @type {HTMLInputElement} */ (document.getElementById("password"));
const submit = /** @type {HTMLButtonElement} */ (document.getElementById("submit"));
const why = document.getElementById("why");

const ROOT = new URL("../../", import.meta.url); // where our server begins, below any path of a proxy

/**
 * Where to go after the login: the screen that was asked for, else the fleet. Never to another site.
 * @param {string} search the query of this page, `?next=/r/pebble/robots/goob`
 * @returns {string}
 */
export function nextPage(search) {
  const next = new URLSearchParams(search).get("next") ?? "";
  return /^\/(r\/[^\\\s]*|\?watch)$/.test(next) ? next : "/";
}

/**
 * @returns {Promise<string>} why it was refused; "" if it was not
 */
async function logIn() {
  let response;
  try {
    response = await fetch(new URL("api/login", ROOT), {
      method: "POST",
      headers: { "content-type": "application/json" },
      body: JSON.stringify({ user: user.value.trim(), password: password.value }),
    });
  } catch {
    return "No connection to the server";
  }
  const answer = await response.json().catch(() => ({}));
  return response.ok ? "" : answer.why || `The server answers ${response.status}`;
}

form?.addEventListener("submit", async (event) => {
  event.preventDefault();
  submit.disabled = true;
  why.textContent = "";
  const refused = await logIn();
  if (!refused) {
    const next = new URL(`.${nextPage(location.search)}`, ROOT);
    location.assign(next.href.startsWith(ROOT.href) ? next : ROOT);
    return;
  }
  submit.disabled = false;
  why.textContent = refused;
  password.value = "";
  password.focus();
});
