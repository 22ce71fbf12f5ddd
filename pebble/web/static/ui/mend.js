// Keeps what is on the page what the page has drawn: translators, grammar checkers and other extensions replace, wrap,
// move and remove nodes of text, and what is drawn after that would be written into nodes that are no longer shown.

import { options } from "../vendor/preact.mjs";

const AGAIN_MS = 250; // a foreign script that never ends keeps this page no more busy than that

/**
 * To be called once, for the element into which everything is drawn; of what was before, too.
 * @param {any} root @param {() => void} onReplaced called when all of the document was: what listens to keys and buttons may be gone, too
 */
export function keepWhole(root, onReplaced) {
  const { documentElement: html, body } = document;
  let foreign = true;
  let timer = 0;
  const note = () => {
    foreign = true;
    timer ||= setTimeout(check, AGAIN_MS);
  };
  const check = () => {
    foreign ||= observer.takeRecords().length > 0;
    clearTimeout(timer);
    timer = 0;
    if (!foreign) return;
    foreign = false;
    if (document.documentElement !== html) return onReplaced();
    try {
      // without what is in its place: a copy would show for ever what was so
      if (!root.isConnected) (document.body ?? html.appendChild(body)).replaceChildren(root);
      mend(root.__k, root);
    } finally {
      observer.takeRecords(); // our own
    }
  };
  const observer = new MutationObserver(note);
  observer.observe(document, { childList: true, characterData: true, subtree: true });
  options.debounceRendering = (draw) =>
    queueMicrotask(() => {
      check(); // Preact cannot draw among nodes that were moved
      draw();
      observer.takeRecords();
    });
  check();
}

/**
 * Give an element the children, and those their texts, that were drawn last.
 * @param {any} vnode of Preact, with its own names: __k are children, __e is the node @param {any} element
 */
function mend(vnode, element) {
  const drawn = nodes(vnode.__k);
  for (const one of drawn) {
    if (one.type === null) {
      if (one.__e.data !== String(one.props)) one.__e.data = one.props;
    } else if (!one.ref || one.props.children !== undefined) mend(one, one.__e); // else we may fill it: a plot
  }
  const own = new Set(drawn.map(({ __e }) => __e));
  for (const node of [...element.childNodes]) if (!own.has(node)) node.remove();
  const { childNodes } = element; // what stays in its place keeps focus and pointer
  if (childNodes.length !== own.size || [...own].some((node, index) => node !== childNodes[index])) {
    element.replaceChildren(...own);
  }
}

/** Elements and texts, without the components that drew them. */
const nodes = (children) =>
  (children ?? []).flatMap((one) => (one === null ? [] : typeof one.type === "function" ? nodes(one.__k) : [one]));
