/** The caller's key. It is kept for this tab only, and asked for when the service wants one. */

import { el } from "../dom";

const STORED = "shrinkd.key";
let waiting: Promise<boolean> | null = null;
/** Whether the person would give none: then only what they do themselves asks again. */
let declined = false;

/** The key, where one was given. */
export function key(): string | null {
  return sessionStorage.getItem(STORED);
}

/** Headers that say who is calling. */
export function credentials(): Record<string, string> {
  const known = key();
  return known ? { authorization: `Bearer ${known}` } : {};
}

/** Asks for a key; false when the person would not give one. Requests that fail at the same time ask once. */
export function askForKey(why: string): Promise<boolean> {
  waiting ??= dialog(why).then((given) => {
    waiting = null;
    declined = !given;
    return given;
  });
  return waiting;
}

/** Asks for the key that a request lacked, unless that was declined before. */
export function askOnce(why: string): Promise<boolean> {
  return declined && !waiting ? Promise.resolve(false) : askForKey(why);
}

function dialog(why: string): Promise<boolean> {
  return new Promise((resolve) => {
    const before = document.activeElement as HTMLElement | null;
    const input = el("input", { id: "key", type: "password", autocomplete: "off", spellcheck: "false", required: true });
    input.value = key() ?? "";
    const box = el(
      "dialog",
      { class: "key-dialog", "aria-labelledby": "key-title", "aria-describedby": "key-why" },
      el(
        "form",
        {
          onsubmit: (event: Event) => {
            event.preventDefault();
            sessionStorage.setItem(STORED, input.value.trim());
            close(true);
          },
        },
        el("h2", { id: "key-title" }, "Key or token"),
        el("p", { id: "key-why" }, why),
        el("label", { for: "key" }, "Key"),
        input,
        el("p", { class: "hint" }, "It is sent as Authorization: Bearer and forgotten with this tab. "),
        el(
          "div",
          { class: "actions" },
          el("button", { type: "submit", class: "primary" }, "Use this key"),
          el("button", { type: "button", onclick: () => close(false) }, "Not now"),
          key() &&
            el("button", { type: "button", onclick: () => (sessionStorage.removeItem(STORED), close(true)) }, "Forget the key"),
        ),
      ),
    );
    const close = (given: boolean): void => {
      box.close();
      box.remove();
      before?.focus();
      resolve(given);
    };
    box.addEventListener("cancel", (event) => {
      event.preventDefault();
      close(false);
    });
    document.body.append(box);
    box.showModal();
    input.focus();
  });
}
