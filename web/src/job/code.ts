/** The tabs with the job as programs, and their copy button. */

import { key } from "../api/key";
import { announce, el, uniqueId } from "../dom";
import { LANGUAGES, snippet, type Language, type Recipe } from "./snippets";

/** A panel that reads its recipe anew whenever it is opened or told to. */
export function codePanel(recipe: () => Omit<Recipe, "base" | "key"> | null): { element: HTMLElement; refresh: () => void } {
  const name = uniqueId("language");
  let language: Language = "curl";
  const text = el("pre", { class: "code-text", tabindex: 0, "aria-label": "Program" });
  const copy = el("button", { type: "button" }, "Copy");
  const element = el("details", { class: "code-panel", ontoggle: () => refresh() });
  const refresh = (): void => {
    if (!element.open) return;
    const given = recipe();
    text.textContent = given ? snippet(language, { ...given, base: location.origin, key: key() !== null }) : "The form has no complete job yet.";
    copy.disabled = given === null;
  };
  copy.addEventListener("click", async () => {
    try {
      await navigator.clipboard.writeText(text.textContent ?? "");
      announce(`The ${language} program was copied`);
    } catch {
      // without the clipboard's leave the text is selected, to be copied by hand
      getSelection()?.selectAllChildren(text);
      announce("The program is selected: copy it with the keyboard");
    }
  });
  element.append(
    el("summary", {}, "The same job as a program"),
    el(
      "div",
      { class: "code-bar" },
      el(
        "fieldset",
        { class: "modes" },
        el("legend", { class: "sr" }, "Language"),
        ...LANGUAGES.map((one) =>
          el(
            "label",
            {},
            el("input", { type: "radio", name, checked: one === language, onchange: () => ((language = one), refresh()) }),
            el("span", {}, one),
          ),
        ),
      ),
      copy,
    ),
    text,
  );
  return { element, refresh };
}
