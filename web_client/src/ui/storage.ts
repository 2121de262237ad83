// Choices of the person that this browser remembers, by key. No secrets.

/** Return what is remembered over `defaults`; values of another type are left out. */
export function recall<T extends object>(key: string, defaults: T): T {
  try {
    const found = JSON.parse(localStorage.getItem(key) ?? "{}") as Record<string, unknown>;
    const usable = Object.entries(defaults).filter(([name, value]) => {
      const other = found[name];
      return typeof other === typeof value && Array.isArray(other) === Array.isArray(value);
    });
    return { ...defaults, ...Object.fromEntries(usable.map(([name]) => [name, found[name]])) };
  } catch {
    return { ...defaults };
  }
}

export function remember(key: string, value: object): void {
  try {
    localStorage.setItem(key, JSON.stringify(value));
  } catch {
    // Storage is switched off: the choice counts for this visit.
  }
}
