// Small helpers around the DOM. Text of the session reaches the page through `textContent` and attributes only.

export type Child = Node | string | null;
export interface Props {
  class?: string;
  id?: string;
  title?: string;
  type?: string;
  role?: string;
  for?: string;
  hidden?: boolean;
  disabled?: boolean;
  tabindex?: number;
  aria?: Record<string, string>;
  data?: Record<string, string>;
  attributes?: Record<string, string>;
  on?: Partial<Record<keyof HTMLElementEventMap, (event: Event) => void>>;
}

/** Return a new element. Strings among the children become text. */
export function h<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  props: Props = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  const { class: className, for: htmlFor, hidden, disabled, tabindex, aria, data, attributes, on, ...plain } = props;
  if (className) element.className = className;
  if (htmlFor) element.setAttribute("for", htmlFor);
  if (hidden !== undefined) element.hidden = hidden;
  if (disabled !== undefined) element.toggleAttribute("disabled", disabled);
  if (tabindex !== undefined) element.tabIndex = tabindex;
  for (const [name, value] of Object.entries(plain)) if (value !== undefined) element.setAttribute(name, String(value));
  for (const [name, value] of Object.entries(aria ?? {})) element.setAttribute(`aria-${name}`, value);
  for (const [name, value] of Object.entries(data ?? {})) element.dataset[name] = value;
  for (const [name, value] of Object.entries(attributes ?? {})) element.setAttribute(name, value);
  for (const [name, listener] of Object.entries(on ?? {})) element.addEventListener(name, listener as EventListener);
  for (const child of children) if (child !== null) element.append(child);
  return element;
}

/** Set the text of an element if it differs: screen readers and selections stay undisturbed. */
export function setText(element: Element, text: string): void {
  if (element.textContent !== text) element.textContent = text;
}

/** Set what an element is called where its text does not say it, if it differs. */
export function setLabel(element: Element, text: string): void {
  if (element.ariaLabel !== text) element.ariaLabel = text;
}

/** Return a button with a text. */
export function button(text: string, onClick: () => void, props: Props = {}): HTMLButtonElement {
  return h("button", { type: "button", ...props, on: { click: onClick, ...props.on } }, text);
}

/** Options that selects have, as one text. */
const shownOptions = new WeakMap<HTMLSelectElement, string>();

/** Replace the options of a select if they differ, and keep what is chosen. */
export function setOptions(select: HTMLSelectElement, options: readonly (readonly [value: string, text: string])[]): void {
  const key = JSON.stringify(options);
  if (shownOptions.get(select) === key) return;
  shownOptions.set(select, key);
  const { value } = select;
  select.replaceChildren(...options.map(([v, text]) => h("option", { attributes: { value: v } }, text)));
  if (options.some(([v]) => v === value)) select.value = value;
}

/** Set the value of a field unless someone is changing it now. */
export function setValue(field: HTMLInputElement | HTMLSelectElement, value: string): void {
  if (document.activeElement !== field && field.value !== value) field.value = value;
}

/** A row that is updated in place, so that focus and open menus survive. */
export interface Row<T> {
  element: HTMLElement;
  update(item: T): void;
}

/** Rows of a list by key: made once, updated in place, moved and removed as the items are. */
export class KeyedList<T> {
  private readonly rows = new Map<string, Row<T>>();

  constructor(
    private readonly parent: HTMLElement,
    private readonly makeRow: (item: T) => Row<T>,
    private readonly empty: HTMLElement | null = null,
  ) {}

  update(items: readonly T[], getKey: (item: T) => string): void {
    const wanted = new Set(items.map(getKey));
    for (const [key, row] of this.rows) {
      if (wanted.has(key)) continue;
      row.element.remove();
      this.rows.delete(key);
    }
    let previous: Element | null = null;
    for (const item of items) {
      const key = getKey(item);
      const row = this.rows.get(key) ?? this.makeRow(item);
      this.rows.set(key, row);
      row.update(item);
      const next: Element | null = previous ? previous.nextElementSibling : this.parent.firstElementChild;
      if (next !== row.element) this.parent.insertBefore(row.element, next);
      previous = row.element;
    }
    if (this.empty) this.empty.hidden = items.length > 0;
  }
}

/** Close what a summary opens on Escape, and on a press anywhere else. */
export function closeOutside(element: HTMLDetailsElement, summary: HTMLElement): void {
  document.addEventListener("pointerdown", (event) => !element.contains(event.target as Node) && (element.open = false), { capture: true });
  document.addEventListener("keydown", (event) => {
    if (event.key !== "Escape" || !element.open) return;
    element.open = false;
    summary.focus();
  });
}

/** Return whether keys mean text or a choice to what has the focus. */
export function takesText(target: EventTarget | null): boolean {
  return target instanceof HTMLElement && target.closest("input[type=text], textarea, [contenteditable], dialog") !== null;
}
