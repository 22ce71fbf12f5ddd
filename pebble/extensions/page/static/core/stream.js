/** The stream that a robot serves itself, or that was entered for it: whether the page may show it in a frame. Pure. */

const LONGEST = 500;
const ADDRESS = /^https?:\/\/([a-z0-9]([a-z0-9.-]{0,252}[a-z0-9])?|\[[0-9a-f:.]{2,45}\])(:[0-9]{1,5})?([/?#][!-~]*)?$/i;

/**
 * Why this address is not shown, for people; "" it may be. Browsers send cookies to every port of a host: hence none of
 * the page's own.
 * @param {string} address @param {{protocol: string, hostname: string}} page its location
 */
export function refusal(address, page) {
  const url = parsed(address);
  if (!url || url.username || url.password || url.port === "0") {
    return "This address is not shown: only http:// and https:// are, without a login";
  }
  if (bare(url.hostname) === bare(page.hostname)) {
    return "This address is on the page's own host, to which browsers would send your login";
  }
  if (page.protocol === "https:" && url.protocol === "http:" && !isLoopback(url.hostname)) return MIXED;
  return "";
}

export const MIXED = "This page came by https; browsers show no stream in it that comes by http";

/** @param {string} address @returns {URL | null} */
function parsed(address) {
  if (address.length > LONGEST || !ADDRESS.test(address)) return null;
  try {
    return new URL(address);
  } catch {
    return null; // a port above 65535, for example
  }
}

const bare = (host) => host.toLowerCase().replace(/\.$/, "");
const isLoopback = (host) => host === "localhost" || host === "127.0.0.1" || host === "[::1]";
